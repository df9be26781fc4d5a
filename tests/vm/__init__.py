"""The package on a real Debian: installed, booted in an emulated computer, and made to suffer. `make vmtest`."""
