"""OpenGL: pictures and depth of a scene."""
