"""Recordings of episodes: the file format, the recorder, and bit-exact replay."""
