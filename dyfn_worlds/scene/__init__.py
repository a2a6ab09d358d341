"""What a scene is made of: meshes, textures, palettes, actors."""
