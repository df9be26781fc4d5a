"""CAN buses: frames on their way in and out, and the signals in them."""
