"""Elevators in the hour when everybody goes home (Crites & Barto 1996): four cars, ten floors, one decision a step."""
