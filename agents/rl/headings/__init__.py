"""The task "headings": choose where to head and what to claim, from features of a map that the robot draws itself."""
