"""The demonstration: one reference, five models on twin stages, a change half way, and a table at the end."""
