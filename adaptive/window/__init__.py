"""The sliding-window LSSVM: configuration, state, compiled steps in two forms, and healing beside the work."""
