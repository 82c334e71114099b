"""stage_node."""
