"""Present state of acquisition: gathered while it runs; used by status, alarms and interfaces."""
