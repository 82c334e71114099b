"""Identification of a stage on live hardware, through its adapter: ``dehyst commission``."""
