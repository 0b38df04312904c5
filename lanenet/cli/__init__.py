"""The command line: one file per verb, each a thin shell over a Python function.

The only room that imports ``datagen``. Verbs for the car are in ``car``, those for experiments in
``research``.
"""
