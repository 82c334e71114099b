"""Configuration of the service: schema, example, reference page, and the learner's settings from a file.

`settings.read_config` reads a file of ``dehyst serve`` into a `ServeConfig`. It imports zenoh; its parser, `schema`,
does not.
"""
