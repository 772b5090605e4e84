"""What a fit is judged by: its weights' shape, where its model errs, what it was worth."""
