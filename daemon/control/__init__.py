"""The control socket: protocol, server and rights."""
