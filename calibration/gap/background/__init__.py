"""Effects named beside a background: smooth errors that no library has, fitted along while names are sought."""
