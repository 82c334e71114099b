"""The modified Prandtl-Ishlinskii model (MPI), equations (2.4)-(2.18).

`MpiParameters` is the model, `identify_mpi` identifies it over an `MpiGrid`, `MpiInverse` is its exact inverse and
`MpiOnline` adapts it; `operators` has the play and dead-zone operators.
"""
