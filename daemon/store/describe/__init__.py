"""The store in words: docs/reference/schema.md, and metadata for Datasette.

words  the meaning of every table, view and column;  description  a store's tables with them;  pages  the two documents
"""
