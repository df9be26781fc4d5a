"""The configuration: its tables, and the file, checked whole before anything is opened."""
