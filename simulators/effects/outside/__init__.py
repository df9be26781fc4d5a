"""Effects that no library names, in whatever form: a search for missing effects must not misname them."""
