"""What a recording tells before a model is fitted: noise, grid, repeats, and what the direct tests of causes read."""
