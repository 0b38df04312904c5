"""Synthetic drives with exact ground truth.

``road`` is what is driven on, ``render`` draws it, ``car`` drives it; ``world`` puts the three together.
"""
