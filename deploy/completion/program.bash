# bash completion of PROGRAM: click knows the words. put-files writes its name into it.
_FUNCTION() {
  local kind word
  COMPREPLY=()
  while IFS=, read -r kind word; do
    case $kind in
      plain) COMPREPLY+=("$word") ;;
      dir) compopt -o dirnames ;;
      file) compopt -o default ;;
    esac
  done < <(COMP_WORDS="${COMP_WORDS[*]}" COMP_CWORD=$COMP_CWORD \
    _VARIABLE_COMPLETE=bash_complete "$1" 2>/dev/null)
}
complete -o nosort -F _FUNCTION PROGRAM
