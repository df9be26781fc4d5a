"""Effects that are in no library in any form: a search for missing effects must not give them a wrong name."""
