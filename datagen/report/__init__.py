"""How good a map is: residuals on frames held out from it, a verdict, and a page for people."""
