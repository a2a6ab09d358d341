"""The node's parameters: one table, declared, checked and documented from it."""
