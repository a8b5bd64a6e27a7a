"""What the chapter, ``neuralq solve`` and the demo draw with: a page of claims and pictures, as text and as SVG."""
