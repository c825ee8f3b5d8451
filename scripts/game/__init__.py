"""The task driven by hand: the state of the game and its view."""
