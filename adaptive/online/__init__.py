"""Learning sample by sample: gates, intake, dead reckoning, trust in the sensor, drift filter, window and learner."""
