"""Golden replay: what a refactoring must not change, pinned on seeded and measured recordings."""
