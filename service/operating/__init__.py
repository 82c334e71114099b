"""The operator's hands: verbs over zenoh, their journal, and the table of what is alive (docs/operating.md)."""
