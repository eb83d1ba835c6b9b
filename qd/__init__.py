"""The quality-diversity search: genes, failure ratios and cells, fitness, archive, and the loop over them."""
