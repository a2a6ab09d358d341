"""What can be asked of a camera, apart from the modules that need libraries."""

# where the camera of a view stands
USUAL = "usual"
PLACEMENTS = (USUAL, "close", "steep", "low", "above")
# how a camera moves: metres a second, radians of slow turning, share
PACES = {
    "standing": ((0.0, 0.12), (0.3, 1.3), 0.2),
    "walking": ((0.3, 1.2), (0.3, 1.2), 0.55),
    "hurried": ((0.8, 1.8), (0.8, 2.2), 0.25),
    "static": ((0.0, 0.0), (0.0, 0.0), 0.0),
    "turning": ((0.0, 0.05), (0.8, 2.2), 0.0),
}
# draws within a pixel, off its middle
SUBPIXELS = ((-0.33, 0.15), (0.15, 0.33), (0.33, -0.33))
SAMPLES = len(SUBPIXELS) + 1
