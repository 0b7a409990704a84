"""Whether a capture fits together: poses, photographs, masks, features, cloud. Checked before a fit is believed."""
