"""The rules that raise and clear alarms: one file a family. A new file, or a new rule in one, needs no other edit."""
