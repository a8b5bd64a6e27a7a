"""What the chapter, reports and pages of the lab draw with: a page of claims and pictures, as text and as SVG."""
