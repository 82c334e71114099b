"""The service's own diagnosis: when its model's error grows, what has changed is found out beside it, not in it."""
