"""State of acquisition at this moment: gathered while it runs, shown to people, alarms and interfaces."""
