"""The mathematics that learns: kernels, features, LSSVM, window, evidence, drift, the learner."""
