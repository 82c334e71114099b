"""The chapter's experiments on a simulated stage: its tables and the data of its figures, as arrays. No plots here."""
