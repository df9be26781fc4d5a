"""The rules that raise and clear alarms, one file per family. A new file or a new rule needs no edit elsewhere."""
