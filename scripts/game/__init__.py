"""Playing the task by hand: the state of a game and its picture."""
