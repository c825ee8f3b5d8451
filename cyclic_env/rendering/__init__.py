"""Pictures of episodes: frames, windows, figures and animations. Imported only when something is drawn."""
