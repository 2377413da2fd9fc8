"""What goes to other people: cards, the Hub, the viewer, the layout of the paper."""
