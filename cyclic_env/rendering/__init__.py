"""Pictures of episodes: rendering, windows, figures and animations. Imported only when something is drawn."""
