"""Scoring methods on a sequence: every second frame is held back, generated from the others, and compared."""
