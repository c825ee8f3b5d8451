"""The comparison of agents: runs, a table that grows, statistics, figures, and a page with replays."""
