"""prandtl_ishlinskii."""
