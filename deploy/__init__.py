"""What a rig's computer gets, and how releases are made."""
