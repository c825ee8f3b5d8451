"""The task: loop closure and its truth, coverage, and the reward."""
