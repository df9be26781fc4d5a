"""Structure that no library names: smooth functions of two joints, and a carrier on a soft jack."""
