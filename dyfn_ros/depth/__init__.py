"""dyfn-depth: depth of pictures, videos and cameras."""
