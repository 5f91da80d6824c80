"""Supervised autonomy for robot fleets: a few people keep many robots working, every intervention makes the fleet better."""

__version__ = "0.1.0"
