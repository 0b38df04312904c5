"""How far synthetic drives look like real ones: statistics of what a network would be given of both."""
