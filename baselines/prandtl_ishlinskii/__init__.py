"""The modified Prandtl-Ishlinskii model (2.4)-(2.18): operators, model, inverse, identification, online form."""
