"""PQN: Q-learning on fresh rollouts of many environments, without replay and target network (Gallici et al. 2024)."""
