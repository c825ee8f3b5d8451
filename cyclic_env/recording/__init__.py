"""Recordings of episodes: their format, the recorder and bit-exact replay."""
