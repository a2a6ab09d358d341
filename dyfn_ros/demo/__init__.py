"""dyfn-demo: a recording played through the live node, and scored."""
