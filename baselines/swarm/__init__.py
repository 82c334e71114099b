"""Searches that need torch: identification by particle swarm, and starts for hyper-parameters by gradient descent."""
