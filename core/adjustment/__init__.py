"""The joint least-squares adjustment of lens, board, poses and rig."""
