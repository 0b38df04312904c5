"""Label sets: from lane lines on a map, or from a simulator's ground truth, to six labels per frame."""
