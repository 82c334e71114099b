"""Bouc-Wen, Prandtl-Ishlinskii and its modified form: models, exact inverses, identification, online forms."""
