"""``dehyst reproduce``: the chapter's tables and figures, drawn and written down beside the chapter's own numbers."""
