"""The version of rigcal, said here and nowhere else: the build, the packages and the public face read it from here."""

VERSION = "0.4.0"
