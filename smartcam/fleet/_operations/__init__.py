"""An agent's metrics, in Prometheus' format, and the trigger counts behind them."""
