"""What several verbs use: options with one meaning, the terminal, and checks of output paths."""
