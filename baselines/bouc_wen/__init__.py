"""bouc_wen."""
