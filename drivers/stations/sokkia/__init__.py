"""The SET two-way protocol of Sokkia total stations and of newer Topcon stations."""
