"""CAN buses: receiving and sending frames, and decoding the signals in them."""
