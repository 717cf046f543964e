"""Scoring methods on a sequence: every second frame is held back, made from the others, and compared."""
