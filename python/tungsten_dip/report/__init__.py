"""What a result looks like and how good it is: metrics, previews and the HTML page."""
