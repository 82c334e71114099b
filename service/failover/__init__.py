"""Who serves an axis: one instance, backed by others that hold the same model and take over when it goes."""
