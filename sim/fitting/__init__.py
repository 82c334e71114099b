"""The stage model that is fitted to a recording: recorded data, the blocks of the model, and least squares.

Nothing here knows an effect of the library (`sim.effects`), whose files build their forms of these parts.
"""
