"""The session's prism: which fixes are of it, judged by the fixes' motion, the boom's standstills and the joints."""
