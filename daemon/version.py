"""The version of rigcal, defined only here: the build, the packages and the public API read it from this module."""

VERSION = "0.4.0"
