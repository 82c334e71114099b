"""Stages that share nothing with the project, and what the service does on them."""
