"""The label sets of a training run: which drives, how each is made and split, and what exists already."""
