"""Kozlowski's lane filter: pairs of points with the spacing of a marking, pairs of markings a lane apart."""
