"""The operator's page: a process of its own that asks the daemon, reads its store, and never touches a device.

settings, server  where the page is served, with or without TLS
access  tokens and roles;  guard  what every request must fulfil and every answer carries
daemon_client  questions to the daemon;  live  its state, read once for all clients
commands  what may be asked for, and by whom;  records, residuals  what the store holds;  app  the addresses
static/  the page itself: HTML, style sheets and ES modules, served as they are
"""
