"""Description of the store for people: docs/reference/schema.md, and metadata for Datasette.

table_words, view_words  the meaning of every table, view and column;  description  a store's tables with their meanings
"""
