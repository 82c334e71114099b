"""Reports for people: the plot style of all pictures, tables, and the files of a diagnosis."""
