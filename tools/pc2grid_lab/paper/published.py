"""The numbers that the paper has printed: Tables I, III and IV."""

from __future__ import annotations

from typing import NamedTuple

MAPS = ("fr079", "intel", "csail", "aces", "killian")

SUBMAPS = dict(zip(MAPS, (67, 68, 102, 98, 91), strict=True))
"""Table I: number of submaps."""

SIZE_PX = dict(zip(MAPS, ((909, 322), (579, 581), (969, 1341), (1172, 1113), (2491, 1990)), strict=True))
"""Table I: width and height of the image. The paper says 0.05 m a pixel for all; killian's image has 0.10."""


class Measures(NamedTuple):
    """Area under the precision-recall curve, recall at a precision of 0.9, F1; each 0 .. 1."""

    auc: float
    rp9: float
    f1: float


def _rows(text: str) -> dict[str, dict[str, Measures]]:
    """A table from its text: each line has a name and, for each map, AUC, RP9 and F1 in thousandths."""
    table = {}
    for line in text.strip().splitlines():
        name, *numbers = line.split()
        values = [int(number) / 1000 for number in numbers]
        table[name] = {m: Measures(*values[3 * i : 3 * i + 3]) for i, m in enumerate(MAPS)}
    return table


TABLE_3 = (
    _rows("""
shape_context 818 293 775 881 601 817 836 446 771 894 731 835 838 561 775
sift_bow      962 984 939 935 768 893 916 749 884 906 638 886 909 714 909
surf_bow      798 149 801 810 136 798 870 459 819 814 147 793 854 271 852
sift_tfidf    975 986 945 948 909 891 920 767 889 952 941 932 943 900 934
surf_tfidf    838 179 830 836 189 830 840 561 804 836 372 803 815 212 818
sdf           999 997 995 998 998 984 979 969 959 980 973 946 989 988 969
proposed      984 966 943 965 946 931 921 796 848 949 940 928 949 924 916
"""),
    _rows("""
shape_context 800 338 743 811 387 757 800 335 727 859 575 773 770 429 696
sift_bow      939 785 892 856 426 808 850 440 807 854 487 805 841 353 807
surf_bow      796 221 758 774 192 738 732 148 718 732 138 724 656 196 638
sift_tfidf    942 871 898 876 570 845 862 290 861 853 276 855 859 551 854
surf_tfidf    805 139 778 815 340 773 762 146 746 696  22 708 694  69 698
sdf           988 980 969 949 912 926 872 787 842 702 543 679 739 582 709
proposed      972 926 916 965 921 923 896 742 819 912 852 879 883 699 816
"""),
    _rows("""
shape_context 697 175 652 763 424 690 749 290 691 814 477 728 736 331 681
sift_bow      897 643 833 822 383 760 793 373 753 721  58 711 662 187 632
surf_bow      717 141 692 741 210 723 630  68 635 618  52 610 567  99 562
sift_tfidf    908 723 861 830 376 783 750 190 745 805 278 778 723 122 702
surf_tfidf    806 420 745 781 284 733 676 122 668 630 219 614 560 213 535
sdf           939 891 907 762 591 712 683 486 632 565 335 494 531 218 456
proposed      967 908 910 955 893 901 838 624 764 855 564 809 818 468 731
"""),
)
"""Table III by noise level, method and map."""

TABLE_4 = {
    int(radius): row
    for radius, row in _rows("""
6  951 831 876 935 850 876 880 751 822 889 733 836 816 476 729
8  972 926 916 965 921 923 896 742 819 912 852 879 883 699 816
10 986 960 945 985 976 951 918 762 843 957 964 934 931 825 863
""").items()
}
"""Table IV by submap radius in metres and map; its row for 8 m is noise level 1 of Table III."""
