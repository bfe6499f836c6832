# bash completion of dcam-ctl: click knows the words.
_dcam_ctl() {
  local kind word
  COMPREPLY=()
  while IFS=, read -r kind word; do
    case $kind in
      plain) COMPREPLY+=("$word") ;;
      dir) compopt -o dirnames ;;
      file) compopt -o default ;;
    esac
  done < <(COMP_WORDS="${COMP_WORDS[*]}" COMP_CWORD=$COMP_CWORD \
    _DCAM_CTL_COMPLETE=bash_complete "$1" 2>/dev/null)
}
complete -o nosort -F _dcam_ctl dcam-ctl
