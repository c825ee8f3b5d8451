"""The K-nearest-neighbour, direction-indicator explorer of Abdulnabi and Esmail (2022)."""
