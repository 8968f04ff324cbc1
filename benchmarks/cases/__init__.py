"""Cases and runs behind the accuracy of estimation and identification."""
