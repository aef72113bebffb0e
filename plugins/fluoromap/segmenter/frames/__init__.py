"""The search of one frame: proposals become fitted and accepted chains; the frame before helps the next."""
