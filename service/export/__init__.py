"""A model without the service: as a C file, as tables, and as an FMU for co-simulation.

The templates beside the modules are the C itself. Words in capitals that they do not define are filled in.
"""
