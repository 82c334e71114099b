"""What has changed in a stage since a model of it was good: the frozen model's error, read as causes."""
