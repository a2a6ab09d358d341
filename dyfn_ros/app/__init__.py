"""`dyfn-app`: a page in the browser that shows the depth of a video."""
