"""Words in a picture."""

import numpy as np

from pacesetter.media.scene import Frame

LINES = 22  # of text that would fill a frame from top to bottom
SMALLEST = 10  # pixels, below which letters cannot be read


def caption(frame: Frame, text: str) -> Frame:
    """The frame with white text on a dark band at the upper left; a small frame cuts it off."""
    from PIL import Image, ImageDraw, ImageFont

    size = max(SMALLEST, frame.shape[0] // LINES)
    image = Image.fromarray(frame)
    pen = ImageDraw.Draw(image, "RGBA")
    font, margin = ImageFont.load_default(size), size // 2
    box = pen.textbbox((2 * margin, 2 * margin), text, font)
    band = (box[0] - margin, box[1] - margin, box[2] + margin, box[3] + margin)
    pen.rectangle(band, fill=(0, 0, 0, 150))
    pen.text((2 * margin, 2 * margin), text, (255, 255, 255), font)
    return np.asarray(image)
