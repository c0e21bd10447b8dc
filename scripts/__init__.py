"""Commands of this repository, and the packages behind them. Nothing of it is installed with the product."""
