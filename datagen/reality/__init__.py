"""How much synthetic drives look like real ones: statistics of what a network would get of both."""
