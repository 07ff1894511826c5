"""The small linear system at the bearings, computed once before training."""
