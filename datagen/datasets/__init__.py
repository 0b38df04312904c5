"""The label sets of a training run: which drives, how they are split, and what is there already."""
