"""The soak: everything that runs, as processes, under a seeded plan of faults, watched by invariants."""
