"""What a picture is before anybody looks for catheters: field, log image, lag, motion, means of frames."""
