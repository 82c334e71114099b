"""Hyper-parameters of the LSSVM: the evidence (2.33)-(2.36), its search, and re-tuning of a window at work."""
