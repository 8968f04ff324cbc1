"""Read runs from bags and folders of results, summarise and write them."""
