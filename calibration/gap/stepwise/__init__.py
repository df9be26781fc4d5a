"""Stepwise search for effects: select an effect, adopt it by a joint refit, revise earlier ones, and repeat."""
