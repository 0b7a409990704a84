"""Whether a capture fits together: poses, photographs, masks, features, cloud. Asked before a fit is believed."""
