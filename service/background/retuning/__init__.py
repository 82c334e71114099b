"""Re-tuning of the learner's hyper-parameters in the background, by a process that cannot hold anybody up."""
