"""The study of Pons Torres et al. 2025, run again: statistics, tables, figures and report beside the paper's."""
