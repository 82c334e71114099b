"""Several online models on the same samples; the best is served.

``competition`` runs them, ``scoring`` measures their errors, ``champion_choice`` decides, ``champion`` is the inverse
model that is served, and ``contestants`` lists what can compete. ``config`` imports no numerics.
"""
