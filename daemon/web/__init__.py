"""The operator's page: a separate process that queries the daemon, reads its store, and never opens a device.

settings, server  where the page is served, with or without TLS
access  tokens and roles;  guard  checks of every request and headers of every answer
daemon_client  requests to the daemon;  live  its state, read once for all clients
commands  permitted commands and their roles;  residuals  fixes from the store with residuals;  app  the routes
static/  the page itself: HTML, style sheets and ES modules, served unchanged
"""
